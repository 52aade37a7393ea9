"""Stage II: lights, normals, reflectance and vertices of an explicit mesh, solved together.

observe.py      what the photographs say about the vertices
blocks.py       the image model's derivatives and normal equations
lights.py       lights with the vertices eliminated; steps of the vertices
reflectance.py  colour
vertices.py     positions from normals and from the agreement of views
refine.py       the rounds
"""
