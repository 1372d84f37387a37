"""What is measured of an episode, when it fails, and by which margin."""
