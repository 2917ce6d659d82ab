"""Level sets of networks over two coordinates (curves) and over one (roots), and their files."""
