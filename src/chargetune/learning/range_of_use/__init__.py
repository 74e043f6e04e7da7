"""One theta for a whole range of use: its loop, the verdict on a theta over drawn plants, and the search."""
