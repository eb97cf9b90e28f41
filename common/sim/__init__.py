"""Simulated worlds: where everything really is, and what cameras see of it. Read by nothing that decides."""
