"""A fish that swims freely in a two-dimensional fluid: a flexible body that bends itself."""
