"""What all drawn pictures share: their colours, and text."""
