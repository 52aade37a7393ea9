"""Methods side by side on one capture: running.py runs what is not there yet, tables.py and pictures.py show it.

    python -m mvps.compare CAPTURE --methods ours,pj16,lz20 --out DIR

DIR holds METHOD/ (the result folder of each, which every other command reads), runs.json (what was run, how long it took, its errors),
table.md, table.csv, table.json, and, where the capture has true normals, normals.png.
"""
