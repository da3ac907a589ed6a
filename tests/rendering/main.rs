//! Tests of the rasterizer, its gradients and metrics, and of the commands that render.

mod metrics_recorded;
#[path = "../models/mod.rs"]
mod models;
mod render_cli;
mod render_gradient;
mod render_oracle;
mod render_reference;
