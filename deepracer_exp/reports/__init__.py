"""Pages, films of what a policy sees, and comparisons: what analysis and evaluation found, drawn and written."""
