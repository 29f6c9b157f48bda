"""The panoramic camera: missions, exterior orientation, projection and rays."""
