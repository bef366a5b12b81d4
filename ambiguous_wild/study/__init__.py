"""Human studies: a page that asks, a key that stays at home, and scores with intervals."""
