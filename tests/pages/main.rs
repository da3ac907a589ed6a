//! Pages for people: the player and reports.

#[path = "../browser/mod.rs"]
mod browser;
#[path = "../models/mod.rs"]
mod models;
mod player;
mod report;
mod report_browser;
#[path = "../scene/mod.rs"]
mod scene;
