"""Control tasks: a fluid is moved over a long run, and its end is judged; README.md."""
