"""``dcon demo``: a live grid, eight emulated PMUs and the controller, as processes that share nothing but sockets."""
