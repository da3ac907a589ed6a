#![no_main]

splatsieve_fuzz::target!("cfg_args");
