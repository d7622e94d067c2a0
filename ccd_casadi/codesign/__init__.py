"""The outer problem, its formulations, verification, baselines and retraining."""
