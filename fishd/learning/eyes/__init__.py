"""Eyes, which convert pictures of the tail to inputs of the network of a policy."""
