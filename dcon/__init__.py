"""dcon: a wide-area damping controller fed by C37.118 streams, its simulation, replay and logs.

Research software: it has never moved a real HVDC line.
"""
