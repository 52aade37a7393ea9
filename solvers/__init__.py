"""Numerical optimisation on arrays; knows no images and no meshes."""
