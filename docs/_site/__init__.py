"""What the documentation site adds to Sphinx: docstrings as they are written here, pages of all public names."""
