"""MLflow: writing and reading runs."""
