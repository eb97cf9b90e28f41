"""Objects of many shapes that no part of the cell knows: drawn by a seed, or from a folder of meshes."""
