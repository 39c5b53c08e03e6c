"""Long campaigns and their tools: mutants, kills, fuzzing, scale; comparing two checkouts."""
