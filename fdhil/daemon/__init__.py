"""The service: sources in, pipelines in worker threads, outcomes to the store and to whoever asks."""
