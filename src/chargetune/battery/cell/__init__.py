"""A cell as data, and the models made of it: equivalent circuit, temperature, lithium plating."""
