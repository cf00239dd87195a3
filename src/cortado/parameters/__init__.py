"""What a run depends on, by name: the list of all parameters, their values and checks, the way to a device and back."""
