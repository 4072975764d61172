"""Evidence for or against each effect: one module for each question."""
