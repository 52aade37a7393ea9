"""Solvers: low rank, linear, bounded least squares, few bounded variables."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from scipy.optimize import lsq_linear

from solvers.adam import Adam
from solvers.bounded import minimise
from solvers.least_squares import bounded_step, cauchy_weights, columns_of_inverse, damped_solution, weighted_rows
from solvers.linear import CholeskyLike
from solvers.low_rank import factorise, robust_weights, solve_rows


def low_rank(seed: int, rows: int = 300, columns: int = 20) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, 3)) @ rng.normal(size=(3, columns))


def test_exact_matrix_with_missing_entries_is_recovered() -> None:
    M = low_rank(0)
    known = np.random.default_rng(1).random(M.shape) < 0.7
    factors = factorise(np.where(known, M, 1e3), known, 3, sweeps=60)
    assert np.abs(factors.left @ factors.right.T - M).max() < 1e-3 * np.abs(M).max()


def test_outliers_are_outvoted() -> None:
    M = low_rank(2)
    rng = np.random.default_rng(3)
    spoiled = np.where(rng.random(M.shape) < 0.05, M + 5, M)
    factors = factorise(spoiled, np.ones(M.shape, bool), 3, sweeps=40, floor=1e-3)
    plain_u, plain_s, plain_v = np.linalg.svd(spoiled, full_matrices=False)
    plain = plain_u[:, :3] * plain_s[:3] @ plain_v[:3]
    assert np.median(np.abs(factors.left @ factors.right.T - M)) < 0.05 * np.median(np.abs(plain - M))


def test_fewer_columns_than_the_rank_are_refused() -> None:
    with pytest.raises(ValueError, match="wanted at least 3 columns, given 2"):
        factorise(np.ones((5, 2)), np.ones((5, 2), bool), 3)


def test_rows_without_entries_solve_to_zero() -> None:
    x = solve_rows(np.ones((2, 4)), np.array([[1.0] * 4, [0.0] * 4]), np.random.default_rng(0).normal(size=(4, 3)))
    assert np.isfinite(x).all() and np.abs(x[1]).max() == 0


def test_weights_fall_with_the_residual_and_unknown_entries_weigh_nothing() -> None:
    weights = robust_weights(np.array([[0.0, 1.0, 2.0, 50.0, 1.0]]), np.array([[1.0, 1.0, 1.0, 1.0, 0.0]]), 0.1)[0]
    assert weights[0] == 1 and (np.diff(weights[:4]) < 0).all() and weights[3] < 0.02 and weights[4] == 0


def test_rows_and_weights_on_tensors_are_those_of_the_factorisation() -> None:
    rng = np.random.default_rng(8)
    M, Y = low_rank(9, 50, 12) + rng.normal(0, 0.1, (50, 12)), rng.normal(size=(12, 3))
    known = (rng.random(M.shape) < 0.7).astype(float)
    known[0], known[1], known[2] = 0, 1, np.arange(12) == 5
    weights = robust_weights(M, known, 1e-3)
    on_tensors = [torch.tensor(a) for a in (M, known, weights, Y)]
    assert np.allclose(cauchy_weights(*on_tensors[:2], 1e-3), weights, rtol=1e-12, atol=0)
    assert np.allclose(weighted_rows(on_tensors[0], *on_tensors[2:], 1e-6), solve_rows(M, weights, Y, 1e-6), rtol=1e-9)


def test_sparse_factor_solves_like_a_dense_one() -> None:
    rng = np.random.default_rng(4)
    B = sp.random(60, 60, 0.1, random_state=5)
    A = (B @ B.T + sp.identity(60)).tocsc()
    right = rng.normal(size=(60, 3))
    found = CholeskyLike(A).nearby(A, right, np.zeros((60, 3)))
    assert np.allclose(found, np.linalg.solve(A.toarray(), right), atol=1e-10)


@pytest.mark.parametrize("seed", range(6))
def test_bounded_step_lowers_the_objective_like_a_bounded_solver(seed: int) -> None:
    rng = np.random.default_rng(seed)
    J, r = rng.normal(size=(40, 5)), rng.normal(size=40)
    x = np.abs(rng.normal(size=5))
    lower = np.array([-np.inf, -np.inf, *-x[2:]])
    exact = lsq_linear(J, -r, (lower, np.inf))
    H, g = (torch.tensor(a, dtype=torch.float64)[None] for a in (J.T @ J, J.T @ r))
    step = bounded_step(H, g, torch.tensor(lower)[None], damping=1e-9)[0].numpy()
    assert (step >= lower - 1e-12).all()
    start, best, reached = (0.5 * np.sum((J @ d + r) ** 2) for d in (np.zeros(5), exact.x, step))
    # Fixing never releases a bound again, so the step may be a little short of the optimum, never worse than standing still.
    assert best - 1e-9 <= reached <= start - 0.9 * (start - best)


@pytest.mark.parametrize(("problems", "unknowns"), [(1, 3), (4, 1), (50, 4)])
def test_small_problems_are_solved_each_for_itself_and_stay_as_they_are(problems: int, unknowns: int) -> None:
    rng = np.random.default_rng(problems)
    J, r = rng.normal(size=(problems, 12, unknowns)), rng.normal(size=(problems, 12, 1))
    H, g = (torch.tensor(a) for a in (J.transpose(0, 2, 1) @ J, (J.transpose(0, 2, 1) @ r)[..., 0]))
    given = [a.clone() for a in (H, g)]
    step = bounded_step(H, g, torch.full_like(g, -torch.inf), damping=0.0)
    inverse = columns_of_inverse(H, 1, damping=0.0)[..., 0]
    assert np.allclose(step, -np.linalg.solve(H.numpy(), g.numpy()[..., None])[..., 0], rtol=1e-4)
    assert np.allclose(inverse, np.linalg.inv(H.numpy())[..., 0], rtol=1e-4, atol=1e-8)
    assert all(torch.equal(a, b) for a, b in zip((H, g), given, strict=True))


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_rank_deficient_problems_give_finite_damped_steps(rank: int) -> None:
    J = np.random.default_rng(7).normal(size=(30, 4)) * (np.arange(4) < rank)
    r = np.ones(30)
    H, g = (torch.tensor(a, dtype=torch.float32)[None] for a in (J.T @ J, J.T @ r))
    step = bounded_step(H, g, torch.full((1, 4), -torch.inf))[0]
    assert torch.isfinite(step).all() and step[rank:].abs().max() == 0


def test_adam_steps_like_torch_and_only_the_parameters_in_use() -> None:
    generator = torch.Generator().manual_seed(0)
    shapes = ((2, 5, 3), (30, 3))
    start = [torch.randn(shape, generator=generator) for shape in shapes]
    theirs, ours = ([p.clone() for p in start] for _ in range(2))
    reference = torch.optim.Adam([p.requires_grad_() for p in theirs], lr=0.1, betas=(0.9, 0.99), eps=1e-8)
    adam = Adam(ours, (0.9, 0.99), 1e-8)
    with ThreadPoolExecutor(2) as pool:
        for step in range(6):
            used = 1 if step < 3 else 2
            halves = [[torch.randn(shape, generator=generator) for _ in range(2)] for shape in shapes[:used]]
            for k, p in enumerate(theirs):
                p.grad = halves[k][0] + halves[k][1] if k < used else torch.zeros_like(p)
            reference.step()
            adam.step(halves, [0.1] * used, pool)
    assert all(torch.allclose(mine, p.detach(), atol=1e-6) for mine, p in zip(ours, theirs, strict=True))


def test_a_factor_serves_a_nearby_matrix() -> None:
    rng = np.random.default_rng(0)
    A = sp.csc_matrix(sp.diags([-np.ones(49), 3 * np.ones(50), -np.ones(49)], [-1, 0, 1]))
    near = sp.csc_matrix(A + sp.diags(rng.uniform(0, 0.5, 50)))
    x = rng.normal(size=(50, 3))
    found = CholeskyLike(A).nearby(near, near @ x, np.zeros((50, 3)))
    assert np.abs(found - x).max() < 1e-5


def test_a_matrix_that_is_not_near_is_solved_all_the_same() -> None:
    rng = np.random.default_rng(0)
    A = sp.csc_matrix(sp.identity(400))
    far = sp.csc_matrix(sp.diags([-np.ones(399), 2.0001 * np.ones(400), -np.ones(399)], [-1, 0, 1]))
    x = rng.normal(size=(400, 2))
    factor = CholeskyLike(A)
    assert np.allclose(factor.nearby(far, far @ x, np.zeros((400, 2))), x, atol=1e-6)
    # What comes after is nearer to it.
    assert np.allclose(factor.solve(far @ x), x, atol=1e-6)


def test_few_bounded_variables_are_solved_within_their_bounds_and_calls() -> None:
    calls = []

    def bowl(x: np.ndarray) -> float:
        calls.append(x)
        return float("nan") if x[0] > 0.9 else float((x[0] - 0.4) ** 2 + 3 * (x[1] + 2) ** 2)

    best, value = minimise(bowl, np.zeros(2), np.array([-1.0, -1.0]), np.ones(2), 0.5, 0.01, 40)
    assert np.allclose(best, [0.4, -1.0], atol=0.05) and value == bowl(best) and len(calls) <= 41


def test_a_bounded_search_never_ends_worse_than_its_start() -> None:
    best, value = minimise(lambda x: float(np.abs(x).sum()), np.zeros(1), -np.ones(1), np.ones(1), 0.5, 0.1, 5)
    assert best == 0 and value == 0


def test_a_matrix_that_rounding_made_indefinite_still_gives_a_step_down() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(5, 8, generator=generator, dtype=torch.float64)
    semidefinite, gradient = rows.T @ rows, rows.T @ torch.ones(5, dtype=torch.float64)
    definite = semidefinite + torch.eye(8, dtype=torch.float64)
    torch.testing.assert_close(damped_solution(definite, gradient), torch.linalg.solve(definite, gradient))
    step = damped_solution(semidefinite - 1e-9 * torch.eye(8, dtype=torch.float64), gradient)
    assert torch.isfinite(step).all() and step @ gradient > 0
    torch.testing.assert_close(semidefinite @ step, gradient, rtol=1e-3, atol=1e-3)
    assert (damped_solution(torch.full((2, 2), torch.nan, dtype=torch.float64), gradient[:2]) == 0).all()


def test_few_rows_of_which_one_is_complete_have_factors_too() -> None:
    M = low_rank(4, rows=8, columns=6)
    known = np.ones(M.shape, bool)
    known[1:, 5] = False
    known[2, 1] = False
    factors = factorise(np.where(known, M, 1e3), known, 3, sweeps=60)
    assert factors.right.shape == (6, 3) and len(factors.singular_values) == 6
    assert np.abs(factors.left @ factors.right.T - M)[known].max() < 1e-2 * np.abs(M).max()
    with pytest.raises(ValueError, match="wanted at least 3 rows, given 2"):
        factorise(M[:2], known[:2], 3)
