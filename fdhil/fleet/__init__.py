"""Many machines: what each tells (uplink), where it is gathered (collector), and what is asked of all (questions)."""
