"""Makes the pictures of a film, one by one or in several processes."""
