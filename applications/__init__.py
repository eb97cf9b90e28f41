"""Applications of the project, one package each; `common/application.py` says what one declares."""
