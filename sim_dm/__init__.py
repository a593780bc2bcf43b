"""The simulated deformable mirror."""
