"""The world: CarRacing, its frames and difference images, and the dream."""
