"""The outer problem, its formulations, verification, baselines and retraining."""

FORMULATIONS = ("nested", "lifted", "direct")
