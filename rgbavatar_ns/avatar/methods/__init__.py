"""Other methods' parts, each once: colours, carriers, fields, loss terms, density control."""
