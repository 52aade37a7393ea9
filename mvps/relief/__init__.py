"""One view: what a silhouette, integrability and few albedos say of unknown lights, and depth from normals.

silhouette.py   rough normals of an inflated silhouette
ambiguity.py    the 3 x 3 ambiguity of unknown lights
integrate.py    depth from normals, with discontinuities
surface.py      an open mesh of the pixels
"""
