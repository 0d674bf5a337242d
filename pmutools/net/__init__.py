"""Live C37.118 streams: endpoints as URLs, UDP and TCP with kernel arrival stamps, client and server roles.

One selector loop a process, no threads: :class:`~pmutools.net.receiver.Receivers` is what a reader or a controller
polls, :class:`~pmutools.net.server.Senders` what a player or an emulated PMU publishes through.
"""
