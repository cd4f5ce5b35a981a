"""Code that every part may import and that imports none of them: signals, errors, clocks, files."""
