"""What is asked of a fitted model beside its predictions: derivatives, and all this for control loops."""
