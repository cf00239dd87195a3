"""Pictures of fluid in space: the surface around its particles, and a ray tracer for it, both on a device."""
