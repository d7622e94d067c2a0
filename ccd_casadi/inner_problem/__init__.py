"""The inner problem: ω_b*(θ), the largest bandwidth over the weights' break frequencies."""
