"""Which particles are joined by springs: from tracks alone."""
