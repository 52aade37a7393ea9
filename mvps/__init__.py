"""mvps: multi-view photometric stereo, from photographs under unknown lights to a relightable, textured mesh."""

__version__ = "0.1.0"
