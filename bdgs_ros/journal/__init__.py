"""What a run leaves on the disk while it goes on, so that whatever dies can go on with it."""
