"""From frames to displacements: the thread's loop, and the pure step that does the measuring."""
