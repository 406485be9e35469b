"""Training of the pose network on views that a map renders of itself."""
