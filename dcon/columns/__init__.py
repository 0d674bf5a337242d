"""A session's log as numpy columns: what looks at whole sessions afterwards begins with them."""
