"""The velocity projection: it pulls as well as it pushes, and keeps particles even."""
