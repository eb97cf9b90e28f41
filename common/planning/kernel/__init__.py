"""The compiled planning kernel: free states, edges proved free, distances. docs/planning.md explains it."""
