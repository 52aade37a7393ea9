"""mvps: multi-view photometric stereo, from photographs under unknown lights to a relightable, textured mesh."""

import os

__version__ = "0.1.0"

# Work is dealt to threads view by view. The threads of OpenBLAS and OpenMP on top of these only wait for each other (twice the time on two
# cores), so they stay off unless the user asks for them; libraries read this when they are first imported.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
