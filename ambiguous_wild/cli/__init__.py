"""The command line: one file a topic, whose commands parse, call and print."""
