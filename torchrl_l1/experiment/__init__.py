"""Running recipes: schema, run directories, logging, evaluation, verification."""
