"""Captures that are hard: scenes.py before the photographs are taken, damage.py after, cases.py the table of them."""
