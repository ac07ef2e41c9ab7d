TRUSTED_TYPES: list[str] = []
