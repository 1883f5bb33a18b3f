"""The paper's tables, theirs and ours side by side."""
