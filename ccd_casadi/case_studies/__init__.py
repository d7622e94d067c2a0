"""Case studies: plants of their own, found by the registry as any other package's are."""
