"""What a person sees in Meshcat: rays, skeleton, state, recording."""
