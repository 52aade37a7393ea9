"""Methods side by side on one capture: running.py runs what is not there yet; tables.py, curve.py and pictures.py show it.

    python -m mvps.compare CAPTURE --methods ours,pj16,lz20 --out DIR

DIR holds METHOD/ (the result folder of each, which every other command reads), runs.json (what was run, how long it took, its errors),
table.md, table.json and a CSV a protocol; where the capture has true normals, normals.png; with --curve, curve_ERROR.svg.
"""
