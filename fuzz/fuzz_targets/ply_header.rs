#![no_main]

splatsieve_fuzz::target!("ply_header");
