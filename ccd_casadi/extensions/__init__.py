"""Extensions: each sub-package is found by `support.extensions`; the core imports none of them."""
