#![no_main]

splatsieve_fuzz::target!("compressed_ply");
