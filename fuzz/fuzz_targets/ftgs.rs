#![no_main]

splatsieve_fuzz::target!("ftgs");
