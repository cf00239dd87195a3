"""What is read and written: run folders, trajectories, pictures, videos, reports, progress on a terminal."""
