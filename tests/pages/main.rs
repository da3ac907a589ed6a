//! Tests of HTML pages: the player, reports and the demo.

#[path = "../browser/mod.rs"]
mod browser;
mod demo;
#[path = "../models/mod.rs"]
mod models;
mod player;
mod report;
mod report_browser;
#[path = "../scene/mod.rs"]
mod scene;
