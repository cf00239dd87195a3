"""The leaderboard of gradient estimators: ``python -m benchmarks.gradients``."""
