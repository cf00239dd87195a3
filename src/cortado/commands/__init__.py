"""The commands of the command line, one a file: arguments in, files and a sentence out."""

import warp as wp

wp.config.log_level = wp.LOG_ERROR
