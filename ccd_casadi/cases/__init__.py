"""Case files, what is wrong with them, and finished run folders."""
