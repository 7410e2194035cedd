"""Pages, films of a policy's view, and comparisons: the results of analysis and evaluation."""
