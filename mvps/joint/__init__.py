"""Stage II: lights, normals, reflectance and vertices of an explicit mesh, solved together.

observe.py      what the photographs say about the vertices
thinned.py      fewer lights of every view
blocks.py       the image model's derivatives and normal equations
steps.py        steps of the vertices, ties, confidence
patches.py      patches of the mesh whose mean slope is known
lights.py       lights with the vertices eliminated
trial.py        held-out errors of a reflectance model
pixels.py       normals of single views at their pixels
reflectance.py  colours of the lights
colours.py      colours of body and lobes
photometry.py   the photometric part of a round
fused.py        the views' normals together, on vertices and faces
agreement.py    where views agree that the surface is
vertices.py     positions from normals, agreement and masks
stated.py       the error that is stated with the normals
refine.py       the rounds
held_out.py     lights of photographs that were kept back
"""
