"""The cases of the examination, what can be known of each, and the marks."""
