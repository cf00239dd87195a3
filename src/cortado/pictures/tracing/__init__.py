"""Pictures of fluid in 3-D: the surface of the fluid, and a ray tracer."""
