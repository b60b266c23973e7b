//! The signal-processing kernels of echolake.
