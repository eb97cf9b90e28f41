"""What a shell may offer for the word that is being typed, read from files: nothing heavy is imported for it."""
