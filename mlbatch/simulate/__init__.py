"""Raw packets of a moving rig in a scene, with ground truth (docs/simulate.md)."""
