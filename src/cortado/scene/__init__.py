"""What a user writes: the tables of a scene, checked and frozen."""
