#![no_main]

splatsieve_fuzz::target!("pickle_bytes");
