"""What is done with a checkout, never from an installation: packages, their checks, pictures of the documents."""
