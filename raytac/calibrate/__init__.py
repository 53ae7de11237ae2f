"""Real sensor images with known indenters: reading them, and fitting sensors to them."""
