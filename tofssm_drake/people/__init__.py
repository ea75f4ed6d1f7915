"""The person: skeleton, generated walk, recordings, avatar."""
