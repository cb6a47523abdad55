"""What pairs of a seen and a mapped element, alone and by twos, say of where the camera is."""
