"""User studies: an HTML page with questions, a private key, and scores with intervals."""
