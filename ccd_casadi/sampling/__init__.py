"""True samples: the store, and the sampler that fills it on processes or a cluster."""
