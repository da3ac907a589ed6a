#![no_main]

splatsieve_fuzz::target!("cameras_json");
