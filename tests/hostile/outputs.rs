//! Links, devices, shared outputs, kills and failures in place of ordinary output files.
