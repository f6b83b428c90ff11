"""What a viewer would draw along a camera path: budgeted cuts, frame by frame, and what they cost."""
