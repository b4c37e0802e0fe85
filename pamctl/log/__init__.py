"""All that knows MCAP: the schema, the recorder, the reader, and what mends a broken log."""
