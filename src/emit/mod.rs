//! Sinks: model folders, PLY files, containers, rows.
