"""One run and many: plan, train, measure, write and read results."""
