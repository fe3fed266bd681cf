"""Koopman models: dictionaries, data, EDMD, predictors, validation."""
