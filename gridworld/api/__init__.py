"""What a Python program or a notebook calls: the commands' work without a command line."""
