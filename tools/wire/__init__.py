"""A cell in the formats of other tools and languages: JSON Schema of its messages, AsyncAPI of its keys."""
