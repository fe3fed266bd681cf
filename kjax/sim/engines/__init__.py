"""Engines: MuJoCo in C for one robot or for batches, and MJX; one contract.

``engine = Engine(config)``, then ``engine.run(configs, on_progress) -> Recording`` for any configs
with the engine's ``batch_spec``.
"""
