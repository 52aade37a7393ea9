"""What is wrong with a capture: each file here checks one kind of fault, and mends what it can (mvps/sound.py)."""
