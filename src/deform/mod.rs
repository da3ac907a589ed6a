//! The deformation field of a 4DGaussians model: HexPlane features and MLP heads, evaluated in blocks.
