"""Files that hold measurements: captures, raw frames, tables, logs."""
