"""Pictures: pixels, files, contact sheets and animations; their differences; charts, and plots of scenes and trees."""
