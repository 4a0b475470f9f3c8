"""Where frames come from: videos, image files, cameras, a user's mattes."""
