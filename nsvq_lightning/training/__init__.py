"""The Lightning module, its state, its optimiser, and the trainer around them."""
