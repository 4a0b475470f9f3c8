"""What is drawn over and beside pictures: one of each."""
