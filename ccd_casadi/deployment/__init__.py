"""From a synthesised controller to sampled code: reduce, discretise, verify, write."""
