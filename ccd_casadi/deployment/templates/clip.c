        cut[i] = sum;
        if (sum > $limit)
            sum = $limit;
        if (sum < -$limit)
            sum = -$limit;
        cut[i] = sum - cut[i];
