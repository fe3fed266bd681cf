"""Engines: MuJoCo in C for one robot or for batches, and MJX; one contract.

``engine = Engine(spec)``, then ``engine.run(episodes, on_progress) -> Recording`` for any episodes
of that spec. ``sim.resolve`` makes both from configs: ``batch_spec``, ``resolve_episode``.
"""
