"""Published methods, written from their papers, with the same inputs and outputs as ours."""
