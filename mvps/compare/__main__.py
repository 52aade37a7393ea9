"""The command line: python -m mvps.compare."""

from __future__ import annotations

from argparse import SUPPRESS, ArgumentTypeError
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mvps.command import parse, parser, run
from mvps.evaluate import PROTOCOLS, protocol_list
from mvps.folders import write_whole
from mvps.inputs import shown
from mvps.methods import BUDGETS, METHODS, OPTIONS, listed_methods
from mvps.progress import Progress
from mvps.published import AVERAGE, DILIGENT_OBJECTS, diligent_object
from mvps.scene import CaptureError


def method_list(text: str) -> tuple[str, ...]:
    """Names of methods, separated by commas."""
    names = tuple(word.strip() for word in text.split(","))
    for name in names:
        if name not in METHODS:
            raise ArgumentTypeError(f"wanted some of {', '.join(METHODS)}, given {name!r}")
    return tuple(dict.fromkeys(names))


def checked(kind: Callable[[str], Any]) -> Callable[[str], str]:
    """A type for an option whose text is passed on as it is, once `kind` has not complained of it."""

    def text_of(text: str) -> str:
        kind(text)
        return text

    text_of.__name__ = kind.__name__
    return text_of


def capture_size(capture: Path) -> tuple[int, int]:
    """Numbers of views and of photographs in the first of them."""
    views = sorted(capture.glob("view_*"))
    return len(views), sum(path.stem.isdecimal() for path in views[0].glob("*.png")) if views else 0


def write_pictures(capture: Path, methods: Sequence[str], out: Path) -> None:
    """normals.png of the first view with true normals; nothing where there is none."""
    from mvps.compare.pictures import cropped, side_by_side
    from mvps.export import read_reconstruction
    from mvps.load import read_truth
    from mvps.texture import png_bytes

    truth = read_truth(capture).normals
    found = {name: read_reconstruction(out / name) for name in methods}
    common = [view for view in truth if all(view in result.views for result in found.values())]
    if not found or not common:
        return
    view = common[0]
    box = cropped(truth[view])
    maps = {name: result.normal_maps[result.views.index(view)][box] for name, result in found.items()}
    write_whole(out / "normals.png", png_bytes(side_by_side(truth[view][box], maps)))


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = parser(
        "mvps.compare",
        "Run methods on a capture, each in a process of its own, and set them side by side: a table (DIR/table.md, .csv, .json),\n"
        "pictures of normals and their errors, all of it on one page (DIR/report.html), the meshes (DIR/METHOD). What DIR\n"
        "holds already is not run again.\n\n" + listed_methods(),
    )
    made.add_argument("capture", type=Path, help="folder in the DiLiGenT-MV layout")
    made.add_argument("--methods", type=method_list, default="ours,ours-draft,hull", metavar="NAME,NAME", help="some of the above")
    made.add_argument("--out", type=Path, required=True, help="folder of the comparison; what it holds is kept")
    made.add_argument("--curve", action="store_true", help="run ours with growing budgets too, and draw error against time")
    for name, (kind, _, words) in OPTIONS.items():
        made.add_argument(f"--{name}", type=checked(kind), default=SUPPRESS, help=words)
    made.add_argument(
        "--protocols",
        type=protocol_list,
        metavar="NAMES",
        help=f"how to measure: all, or some of {', '.join(PROTOCOLS)}; ours if not given, all beside what papers printed",
    )
    made.add_argument(
        "--published",
        choices=(*DILIGENT_OBJECTS, AVERAGE),
        help="object of DiLiGenT-MV whose printed figures stand beside, or their average; the capture's own where it is one of them",
    )
    given = parse(made, argv)
    from mvps.compare.curve import drawings
    from mvps.compare.page import page_html
    from mvps.compare.running import run_all
    from mvps.compare.tables import heading, otherwise_rows, protocol_rows, rows, write_tables

    texts = {name: getattr(given, name.replace("-", "_"), None) for name in OPTIONS}
    options = [f"--{name}={text}" for name, text in texts.items() if text is not None]
    methods = tuple(dict.fromkeys((*given.methods, *(BUDGETS if given.curve else ()))))
    # As in a result: "." has a name too, and what is no UTF-8 in it can be written.
    capture_name = shown(Path(given.capture.resolve().name))
    printed = given.published or diligent_object(capture_name, *capture_size(given.capture))
    protocols = given.protocols or (tuple(PROTOCOLS) if printed else ("ours",))
    runs = run_all(given.capture, methods, options, given.out, Progress(), protocols)
    chosen = [runs[name] for name in methods]
    if all(one.failed for one in chosen):
        raise CaptureError(chosen[0].failed)
    curves = drawings(chosen) if given.curve else {}
    for key, text in curves.items():
        write_whole(given.out / f"curve_{key}.svg", text)
    done = [one for one in chosen if not one.failed]
    write_pictures(given.capture, [one.method for one in done], given.out)
    tables = {"ours": rows(chosen)} | {name: protocol_rows(name, done, printed or AVERAGE) for name in protocols if name != "ours"}
    if printed:
        tables["otherwise"] = otherwise_rows(printed)
    print(write_tables(tables, given.out))
    picture = given.out / "normals.png"
    headed = {heading(name): lines for name, lines in tables.items()}
    page = page_html(capture_name, headed, curves, picture.read_bytes() if picture.exists() else None)
    write_whole(given.out / "report.html", page)


if __name__ == "__main__":
    raise SystemExit(run(main))
